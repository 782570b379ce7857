"""Checks that the WIT package, the classes of `_gleaner` and those of the package `gleaner` have
the same names.

The rules: `-` becomes `_`, types are in CamelCase. The functions of the interfaces `data`,
`trigger` and `log` are methods of `Context`, those of `scratch` of `ctx.scratch`. Resources are
classes, records are named tuples, the case of an error is the `kind` of an exception, an enum is a
set of strings. A property is constant while a handle exists; a method calls the host.

`gleaner.Tensor` and `gleaner.Model` convert between numpy and the host's objects, so the WIT has
two descriptions of each: the class of the package, and `HostTensor` and `HostModel`.
"""

from __future__ import annotations

import inspect
import typing
import unittest
from typing import Any, Dict, Iterable, List, Set, Tuple

import home
import wit

import gleaner
from gleaner import data, inference, log
from gleaner.testing import _context, _data, _frame, _inference, _session


class Described:
    """The classes of a host, as the package describes them."""

    Context, Scratch = gleaner.Context, gleaner.Scratch
    Topic, Field, Sample, Frame = gleaner.Topic, gleaner.Field, gleaner.Sample, gleaner.Frame
    Tensor, Model = inference.HostTensor, inference.HostModel


class Local:
    """The classes of `gleaner.testing`."""

    Context, Scratch = _context.Context, _session.Scratch
    Topic, Field, Sample, Frame = _data.Topic, _data.Field, _data.Sample, _frame.Frame
    Tensor, Model = _inference.Tensor, _inference.Model


INTERFACES = wit.read(home.CHECKOUT / "wit")
OF_CONTEXT = ("data", "trigger", "log")

PROPERTIES: Dict[str, Set[str]] = {
    "Context": {"config", "missed", "scratch"},
    "Scratch": set(),
    "Topic": {"name", "ros_topic", "type_name"},
    "Field": {"path"},
    "Sample": {"identity", "stamps", "size", "big_endian"},
    "Frame": {"info", "identity", "stamps"},
    "Tensor": {"element", "shape", "size"},
    "Model": set(),
}

# Names that only Python has: in the WIT, `config` is an argument of `init`, and `missed` a field of
# the tick.
ONLY_PYTHON: Dict[str, Set[str]] = {
    "Context": {"config", "missed", "scratch"},
    "Frame": {"array", "__array__", "__dlpack__", "__dlpack_device__"},
    "Tensor": {"array", "from_bytes"},
}
ONLY_PACKAGE: Dict[str, Set[str]] = {
    **ONLY_PYTHON,
    "Tensor": {"array", "from_values", "__array__"},
}

# Parameters of the package in place of a record.
KEYWORDS = {"options": gleaner.DetectOptions._fields}

ENUMS: Dict[str, Any] = {
    "encoding": data.Encoding,
    "level": log.Level,
    "element-type": inference.ElementType,
    "placement": inference.Placement,
}

# The type of a Python value replaces the case of these variants.
PLAIN_VARIANTS = {"value", "attribute-value", "config-value", "wake"}
# An attribute is a keyword argument; an entry of the configuration is one of `ctx.config`; `tick`
# is `ctx.missed`.
PLAIN_RECORDS = {"attribute", "config-entry", "tick"}


def snake(name: str) -> str:
    return name.replace("-", "_")


def camel(name: str) -> str:
    return "".join(word.capitalize() for word in name.split("-"))


def wanted() -> Dict[str, Dict[str, wit.Function]]:
    """Returns the functions of each class, by their names in Python."""
    functions = {
        name: function for of in OF_CONTEXT for name, function in INTERFACES[of].functions.items()
    }
    classes = {"Context": functions, "Scratch": INTERFACES["scratch"].functions}
    for interface in INTERFACES.values():
        classes.update({camel(name): functions for name, functions in interface.resources.items()})
    return {
        cls: {snake(name): function for name, function in of.items()} for cls, of in classes.items()
    }


def members(cls: type, only: Set[str]) -> Set[str]:
    """Returns the public names of a class, and the special methods in `only`."""
    return {name for name in dir(cls) if not name.startswith("_") or name in only}


def parameters(cls: type, name: str) -> List[Tuple[str, Any, bool]]:
    """Returns the name and kind of each parameter except `self`, and whether it has a default."""
    given = inspect.signature(getattr(cls, name)).parameters.values()
    return [
        (parameter.name, parameter.kind, parameter.default is not parameter.empty)
        for parameter in given
        if parameter.name != "self"
    ]


class Surface(unittest.TestCase):
    def holds(self, module: Any, only: Dict[str, Set[str]] = ONLY_PYTHON) -> None:
        for name, functions in wanted().items():
            cls, more = getattr(module, name), only.get(name, set())
            with self.subTest(cls=name):
                self.assertEqual(members(cls, more), set(functions) | more)
                for function, declared in functions.items():
                    with self.subTest(function=function):
                        self.function_holds(module, name, function, declared)

    def function_holds(self, module: Any, of: str, name: str, declared: wit.Function) -> None:
        cls = getattr(module, of)
        given = inspect.getattr_static(cls, name)
        if name in PROPERTIES[of]:
            self.assertTrue(inspect.isdatadescriptor(given), "it is a property")
            self.assertEqual(declared.parameters, [])
            return
        self.assertTrue(callable(getattr(cls, name)), "it is a method")
        self.assertEqual(isinstance(given, staticmethod), declared.static)
        wanted = [snake(parameter) for parameter in declared.parameters]
        if module is gleaner:
            wanted = [one for parameter in wanted for one in KEYWORDS.get(parameter, (parameter,))]
        self.assertEqual([parameter for parameter, _, _ in parameters(cls, name)], wanted)

    def test_the_package_has_the_names_of_the_wit(self) -> None:
        self.holds(gleaner, ONLY_PACKAGE)

    def test_the_package_describes_a_host_by_the_names_of_the_wit(self) -> None:
        self.holds(Described)

    def test_the_extension_has_the_names_of_the_wit(self) -> None:
        self.holds(home.extension())

    def test_a_local_run_has_the_names_of_the_wit(self) -> None:
        self.holds(Local)

    def test_the_extension_takes_the_arguments_of_the_package(self) -> None:
        self.takes_arguments_as_described(home.extension())

    def test_a_local_run_takes_the_arguments_of_the_package(self) -> None:
        self.takes_arguments_as_described(Local)

    def test_keyword_arguments_have_the_defaults_of_their_record(self) -> None:
        defaults = {
            name: parameter.default
            for name, parameter in inspect.signature(gleaner.Model.detect).parameters.items()
            if name in gleaner.DetectOptions._fields
        }
        self.assertEqual(defaults, gleaner.DetectOptions()._asdict())

    def takes_arguments_as_described(self, module: Any) -> None:
        for cls, functions in wanted().items():
            callable_names = set(functions) - PROPERTIES[cls]
            if cls == "Tensor":
                callable_names |= ONLY_PYTHON[cls]
            for name in callable_names:
                with self.subTest(cls=cls, name=name):
                    given, described = getattr(module, cls), getattr(Described, cls)
                    self.assertEqual(parameters(given, name), parameters(described, name))

    def test_the_wit_was_parsed(self) -> None:
        self.assertEqual(set(wanted()), set(PROPERTIES))
        self.assertEqual(wanted()["Topic"]["column_since"].parameters, ["field", "since-ns"])
        self.assertEqual(wanted()["Context"]["event"].parameters, ["label", "score", "attributes"])


class Values(unittest.TestCase):
    def test_records_are_named_tuples_with_the_same_fields(self) -> None:
        for name, fields in self.all("records"):
            if name not in PLAIN_RECORDS:
                with self.subTest(record=name):
                    named_tuple = getattr(gleaner, camel(name))
                    # `class` is a keyword of Python.
                    self.assertEqual(
                        named_tuple._fields,
                        tuple(f"{f}_" if f == "class" else snake(f) for f in fields),
                    )

    def test_the_kinds_of_an_error_are_the_cases_of_its_variant(self) -> None:
        for name, cases in self.all("variants"):
            if name not in PLAIN_VARIANTS:
                with self.subTest(variant=name):
                    error = getattr(gleaner, camel(name))
                    kind = typing.get_type_hints(error)["kind"]
                    self.assertEqual(typing.get_args(kind), tuple(cases))
                    self.assertTrue(issubclass(error, gleaner.Error))

    def test_enums_are_strings(self) -> None:
        for name, cases in self.all("enums"):
            with self.subTest(enum=name):
                self.assertEqual(typing.get_args(ENUMS[name]), tuple(map(snake, cases)))

    def all(self, kind: str) -> Iterable[Tuple[str, List[str]]]:
        found = [
            item for interface in INTERFACES.values() for item in getattr(interface, kind).items()
        ]
        self.assertTrue(found)
        return found
