"""How far from what is expected a result counts: one scale for all tests."""

#: Standard errors that may be chance, once in 20 looks, but are worth a hypothesis: a wrong
#: one is thrown out by the comparison that follows.
POSSIBLE = 2.0
#: Standard errors of a single look that is no chance: once in 400.
CLEAR = 3.0
#: Standard errors of what stands out among some hundred: once in 2,000.
OUTLYING = 3.5
#: Standard errors of what is no chance among a thousand looks: once in 16,000.
CERTAIN = 4.0
#: Standard errors beyond any number of looks, and with errors that are not quite normal: once in 2 million.
BEYOND_DOUBT = 5.0

#: Probability of any finding, anywhere, where there is nothing.
FALSE_ALARM = 0.02
#: Probability below which a single result is not put down to chance.
SIGNIFICANCE = 1e-3
#: The same where errors are not quite normal, or a model not quite that of these data.
NO_CHANCE = 1e-6

#: Nats that one more term of a model must bring.
PRICE = 3.0
#: Nats that change no estimate by more than its standard error.
NO_DIFFERENCE = 0.5
#: Nats that leave no choice: the one explains e^10 times as well as the other.
DECISIVE = 10.0

#: Samples expected in a group, at least, for it to count in a chi-square (Cochran 1954).
SMALLEST_EXPECTATION = 5.0
