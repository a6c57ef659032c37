"""Dense depth from the same sparse points and the same predicted depth, completed in several ways, judged alike."""
