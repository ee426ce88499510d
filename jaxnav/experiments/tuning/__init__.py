"""Tune the estimator and the controller by gradient, through the step that runs on the car."""
