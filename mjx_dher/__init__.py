__path__.append(__import__("os").path.dirname(__path__[0]))
