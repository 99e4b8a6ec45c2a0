"""Loop closures: candidates, measurements and tests, of places and of scans."""
