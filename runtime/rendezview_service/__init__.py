"""The pose service: frames in, poses out, watched in a browser, recorded."""
