"""Strips with wave packets: what they hold, their packets and rays, in blocks; and writing them."""
