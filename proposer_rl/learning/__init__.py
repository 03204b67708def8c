"""PPO of one agent, or of K copies of it at once."""
