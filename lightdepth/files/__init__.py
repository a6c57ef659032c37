"""The ground floor: everything that is read from disk or written to it goes through here."""
