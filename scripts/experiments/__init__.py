"""Experiments behind the figures of the README and docs: ``python -m experiments`` lists them."""
