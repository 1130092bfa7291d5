"""How a model is fitted to a scene."""
