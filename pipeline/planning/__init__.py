"""What a procedure could find before it is recorded: simulated without effects, then asked of the diagnosis."""
