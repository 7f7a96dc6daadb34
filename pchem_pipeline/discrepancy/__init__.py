"""Disagreement of model and data: statistics, their null distribution, identification of effects, the gap."""
