"""Hard cases against an oracle: where each scheme and backend breaks, what the defaults promise, what safety costs."""
