"""The replay of a recorded run: its commands are computed again, and the answers compared with the recorded ones."""
