"""From a table of prices to a decision: reading, cleaning, the problem, and what its policies cost out of sample."""
