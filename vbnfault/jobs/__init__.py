"""How the samples of a build are made: tasks, who does them, how that is going, and what ends it early."""
