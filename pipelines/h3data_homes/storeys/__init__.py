"""Homes with two storeys: two plans side by side, as in a house on a slope, with a stairwell between them."""
