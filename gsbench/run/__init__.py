"""Do one run: train a model on a scene, measure it and write its record. Nothing heavy is imported here."""
