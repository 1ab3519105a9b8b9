"""Maps of real and invented cities: reading, writing, drawing and generating them."""
