"""Loop closures: candidates, measurements and tests, of places and of scans.

Not in the paper, whose attention has to learn all this.
"""
