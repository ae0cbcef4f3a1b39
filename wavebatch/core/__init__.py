"""What everything else is made of: units, errors, the types that flow through a chain, and the table of columns."""
