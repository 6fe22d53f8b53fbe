"""A recorded run put through the compensator again."""
