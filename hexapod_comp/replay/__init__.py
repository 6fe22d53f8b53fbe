"""The replay of a recorded run: it computes the answers to the commands again, and compares them with the recording."""
