"""The hub while cameras stream: estimator, agent and messages."""
