"""Raw logs of episodes as MCAP files: written while an episode runs, read, played to a diagram."""
