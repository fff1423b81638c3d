"""`hand init`: a robot's description in, a hand's plugin folder out, with every guess marked."""
