"""The golden file: answers of every sensor, stored and compared."""
