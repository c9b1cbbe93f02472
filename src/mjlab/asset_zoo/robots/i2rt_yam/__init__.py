"""I2RT YAM: arm with six joints and a gripper."""
