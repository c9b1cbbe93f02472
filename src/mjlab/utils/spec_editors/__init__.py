"""The editors behind `mjlab.utils.spec_config`, by what they edit."""
