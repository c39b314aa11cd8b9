"""A folder of recorded maps to groups: an index of promising pairs, worker processes, and a ledger of what is done."""
