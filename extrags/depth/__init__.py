"""Dense depth with its expected error where no sensor gave any: points, stereo, light, completion."""
