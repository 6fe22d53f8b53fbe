"""A running machine calibrated, checked and repaired, step by step, by readings that it takes itself."""
