"""Claims, the ledger and the tables that pages hold."""
