"""Memory: the replay, and what is made of its episodes: batches, goals, rewards."""
