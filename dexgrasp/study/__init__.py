"""A study: several methods made from the same data, judged by the same rules, in tables beside published figures."""
