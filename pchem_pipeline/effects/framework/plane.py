"""The planes of the signal chain, in the order in which the signal crosses them."""

from __future__ import annotations

from enum import Enum


class Plane(Enum):
    """Where in the signal chain an effect acts; iteration gives the order of the chain.

    What an effect receives and returns there, always with dims (frame, y, x):

    ========  =======================================================  ==============
    plane     values                                                   dtype
    ========  =======================================================  ==============
    EXPOSURE  mean number of electrons H_t, e-                         float64, >= 0
    CHARGE    number of electrons K, e-                                int64, >= 0
    ANALOG    input-referred signal with read noise K + R, e-          float64
    ADC       signal at the ADC before rounding, mu + (K + R) / g, DN  float64
    READOUT   digital number X, rounded and cut to the ADC's range     unsigned
    ========  =======================================================  ==============
    """

    EXPOSURE = "exposure"
    CHARGE = "charge"
    ANALOG = "analog"
    ADC = "adc"
    READOUT = "readout"
