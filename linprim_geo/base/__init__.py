"""What every package needs: errors, files, options, progress, memory, time budgets."""
