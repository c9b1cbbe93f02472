"""Command lines. Each parses its arguments and wires objects together; none knows a task."""
