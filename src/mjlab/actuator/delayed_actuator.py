"""The module where releases 1.1 and 1.2 had delayed actuators; today any actuator can be."""

from mjlab.actuator.older import DelayedActuator as DelayedActuator
from mjlab.actuator.older import DelayedActuatorCfg as DelayedActuatorCfg
