"""What is computed every frame: the light that reaches receivers past the bodies in its way."""
