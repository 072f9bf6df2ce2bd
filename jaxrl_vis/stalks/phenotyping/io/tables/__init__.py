"""Tables from outside: odometries and plans of fields."""
