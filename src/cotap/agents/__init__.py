"""Two agents, one body: actors, critics, losses, the learner and its runner."""
