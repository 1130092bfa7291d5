"""What came out of a run: quality, speed, the curve, and the record that keeps them; imports none of them."""
