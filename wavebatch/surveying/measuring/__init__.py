"""What a survey measures on a sample: lone echoes, noise, width and shape of the pulse, and what fits leave."""
