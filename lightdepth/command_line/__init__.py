"""How words become a verb and its options: signatures, help, mistakes, presets, settings that are gone."""
