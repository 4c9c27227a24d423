"""Voices and sounds: frames, the law of loudness, who hears spectators, decoding, mixing at a microphone."""
