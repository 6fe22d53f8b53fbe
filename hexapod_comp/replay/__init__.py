"""A recorded run passed through the compensator again."""
