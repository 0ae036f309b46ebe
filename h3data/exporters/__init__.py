"""Recordings and scenes written in other programs' formats."""
