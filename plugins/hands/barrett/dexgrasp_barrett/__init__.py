"""BarrettHand BH8-280: three fingers, four motors; URDF, geometry and a few lines of YAML."""
