"""The methods that the paper compares VCP with, each a replay to draw mini-batches from."""
