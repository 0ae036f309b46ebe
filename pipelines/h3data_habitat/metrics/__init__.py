"""Measures of habitat-lab, reproduced including its errors."""
