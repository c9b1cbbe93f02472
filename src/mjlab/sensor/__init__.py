"""Sensors: what is measured in the simulation, besides the state of entities."""

from mjlab.sensor.builtin_sensor import BuiltinSensor as BuiltinSensor
from mjlab.sensor.builtin_sensor import BuiltinSensorCfg as BuiltinSensorCfg
from mjlab.sensor.builtin_sensor import ObjRef as ObjRef
from mjlab.sensor.sensor import Sensor as Sensor
from mjlab.sensor.sensor import SensorCfg as SensorCfg
