"""The closed loop: sensors, fusion, guidance and dynamics from tens of metres to contact."""
