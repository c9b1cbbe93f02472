"""Robot assets: configs ready to use in a scene."""
