"""An invented three-finger claw, in YAML and a URDF; there is no code."""
