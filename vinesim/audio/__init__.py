"""Voices and sounds: frames, loudness over distance, who hears whom, decoding, mixing at a microphone."""
