"""Show trained models in a browser, and export them as videos, images and files for other programs."""
