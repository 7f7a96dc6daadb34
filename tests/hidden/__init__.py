"""Stacks of frames with something hidden in them, made by a forward chain of their own.

Numpy alone, one frame after the other, so that it can be checked by reading it. ``make.py`` is the command.
"""
