"""New problems from records, and the encryption of their test records."""
