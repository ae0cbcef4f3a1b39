"""What the commands beside `run` do: a folder each."""
