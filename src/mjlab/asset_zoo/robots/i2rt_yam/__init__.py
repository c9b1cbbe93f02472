"""The I2RT YAM, an arm of six joints with a gripper."""
