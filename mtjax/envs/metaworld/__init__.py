"""Meta-World's fifty tasks of a Sawyer arm (Yu et al. 2019; the third version of its scenes and rewards)."""
