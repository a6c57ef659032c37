"""What leaves this program for others: checkpoints as graphs and as folders for a hub, depth as pictures."""
