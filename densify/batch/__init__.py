"""Many sequences densified, each as a run folder of its own: what is done is not done again, however it was stopped."""
