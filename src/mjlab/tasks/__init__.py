"""Built-in tasks, one package per family, and the task registry."""

from mjlab.utils.lazy import lazy_names

__getattr__ = lazy_names(__name__, {"import_packages": "mjlab.utils.lab_api.tasks.importer"})
