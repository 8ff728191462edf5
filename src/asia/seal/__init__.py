"""The only openers of what nobody in a search may see: test records and guard records."""
