"""Experiments on simulated and recorded drives: studies of the ambiguity, tuning by gradients."""
