"""The physics: kinematics of the table, the measurement equation, its effects and its inversion."""
