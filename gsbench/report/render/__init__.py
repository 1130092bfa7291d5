"""Show sections in a form: one module a form, each from the same shown table."""
