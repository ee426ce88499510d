"""The estimator and the controller tuned by gradient, through the step that runs on the car."""
