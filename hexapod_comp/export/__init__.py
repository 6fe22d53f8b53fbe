"""Export of a machine model for controllers that do not run this package."""
