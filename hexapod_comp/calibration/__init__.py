"""This package fits a machine model to readings and predicts how accurate the model is."""
