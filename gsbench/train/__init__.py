"""Train a model on a scene: gradients, optimizer, density control, hooks, checkpoints.

- The order of a step is `gsbench.train.loop.Trainer.train_step`, and when what happens is gsbench/schedule.py.
- Gaussians are cloned, split, pruned and moved in density/.
- Other options, such as penalties and early stopping, are one module each in hooks/.
"""
