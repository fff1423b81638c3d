"""Allegro hand (right): four fingers of four independent joints."""
