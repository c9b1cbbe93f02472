"""Parts of the proof on a GPU. Each is a module with `measure(options)`, which yields rows."""
