"""Maps of real and generated cities: reading, writing and generating them."""
