"""`wavebatch bench --against`: this wavebatch and another one take turns on the same strips."""
