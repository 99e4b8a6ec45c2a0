"""What a front end of a lidar need not care about: faults of drivers, several scanners, clocks that differ."""
