"""Allegro hand (left): four fingers of four independent joints."""
