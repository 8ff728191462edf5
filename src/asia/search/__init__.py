"""The loop: problem + agent + budget + ledger. Alone holds both an agent and an evaluator."""
