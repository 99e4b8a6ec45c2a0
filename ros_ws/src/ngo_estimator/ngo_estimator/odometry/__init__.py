"""Local estimators: from a sensor's stream to relative poses."""
