"""Train a model on a scene: gradients, optimizer, density control, schedule, checkpoints."""
