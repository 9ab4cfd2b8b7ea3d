"""What is measured on estimates: errors, consistency, and the losses that tuning minimises."""
