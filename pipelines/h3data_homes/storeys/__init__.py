"""Homes with two storeys: two plans side by side in the plan, as of a house on a slope, and a stairwell between them."""
