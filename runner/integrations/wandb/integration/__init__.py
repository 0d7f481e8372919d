"""What `wandb.integration` has for libraries that the runner records."""
