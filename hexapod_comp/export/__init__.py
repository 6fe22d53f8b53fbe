"""A machine model for controllers that do not run this package."""
