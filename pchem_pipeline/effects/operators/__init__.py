"""Effects by what they do to the signal: a module an operator, with its base classes and its effects.

- offset of many samples at once: `offsets`; slow changes and flicker of offset, gain or light: `drifts`;
- read noise of single pixels: `noise`; light at a place, blinking pixels: `light`;
- samples that follow others: `couple`; electrons that are lost, moved, held or multiplied: `fate`;
- monotone curves of voltage or code: `curve`; samples that become others: `replace`; rare events: `strike`;
- noise that is measured and has no name: `empirical_noise`; other empirical effects are with their operator.
"""
