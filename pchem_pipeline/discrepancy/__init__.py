"""Where model and data disagree: statistics, their null distribution, the naming of effects, the gap."""
