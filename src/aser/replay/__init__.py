"""The replay: facts, priorities, criteria and bootstrap rules, put together by a sampler."""
