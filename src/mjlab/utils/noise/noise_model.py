"""Public path of the noise models of `mjlab.utils.noise.noise_cfg`."""

from mjlab.utils.noise.noise_cfg import NoiseModel as NoiseModel
from mjlab.utils.noise.noise_cfg import NoiseModelWithAdditiveBias as NoiseModelWithAdditiveBias
