"""Training all lanes in lock-step: the loop, one update, evaluation, diagnostics, frozen agents."""
