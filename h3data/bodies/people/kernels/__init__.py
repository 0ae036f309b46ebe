"""Compiled functions for people: clips, legs, the joint tree and reaching, for many poses or for one."""
