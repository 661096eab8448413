"""The site model: candidates' posterior, and markings, symbols and lanes of the map, new or updated."""
