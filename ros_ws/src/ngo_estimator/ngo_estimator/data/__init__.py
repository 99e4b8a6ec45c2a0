"""Records and buffers: images, observations, relative steps."""
