"""What ``adapt`` does with a running machine: calibrate it, check its model, repair the model, step by step."""
