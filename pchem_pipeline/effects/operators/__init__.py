"""Effects: a module an operator, which holds what acts on the signal and the effects that are cases of it."""
