"""Errors of estimates, their statistics, and the estimators that the tables compare."""
