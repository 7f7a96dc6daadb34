"""Effects of a sensor whose two colours of pixels, like those of a chessboard, are read differently."""
