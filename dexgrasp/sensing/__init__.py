"""From what a camera or a file gives to a cloud in metres: readers that run nothing and refuse what is too large."""
