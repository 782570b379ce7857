//! Compiling a component has a bound of memory and of CPU time, and what would go beyond is refused in words.

use std::os::unix::fs::PermissionsExt;
use std::process::{Command, Output};

use gleaner_protocol::Exit;
use gleaner_tests::{Copy, Folder, program};

/// A component of so many functions, each of which takes a quarter of a second to be compiled, and not much memory: thousands of values
/// live until its end, and blocks keep the compiler from putting them together.
fn slow(functions: usize) -> Vec<u8> {
    const VALUES: usize = 4000;
    let block = "block local.get 0 i32.wrap_i64 br_if 0 local.get 1 i64.const 3 i64.mul local.set 1 end ";
    let value = format!("local.get 0 i64.const 7 i64.rotl local.tee 0 {block}");
    let body = value.repeat(VALUES) + &"i64.xor ".repeat(VALUES - 1);
    let function = format!("(func (param i64 i64) (result i64) {body})");
    let text = format!("(component (core module {}))", function.repeat(functions));
    wat::parse_str(text).expect("the test's own component")
}

/// `gleaner check` of a lambda that is this component, where compiling has so many seconds.
fn check(component: &[u8], seconds: u64) -> Output {
    let (lambda, home) = (Copy::of("examples/hello/rust", |manifest| manifest), Folder::new());
    lambda.replace("hello.wasm", component);
    let compile = program("gleaner-compile");
    let script = format!("#!/bin/sh\nexec '{}' --cpu-seconds {seconds} \"$@\"\n", compile.display());
    let script = home.write("gleaner-compile", script);
    std::fs::set_permissions(script, PermissionsExt::from_mode(0o755)).unwrap();
    // Without it this would be no installation.
    std::os::unix::fs::symlink(program("gleaner-runtime"), home.path().join("gleaner-runtime")).unwrap();
    let mut check = Command::new(program("gleaner"));
    check.env("GLEANER_HOME", home.path()).env("XDG_CACHE_HOME", home.path().join("cache"));
    check.arg("check").arg(lambda.path()).output().expect("gleaner starts")
}

#[test]
fn a_component_that_is_compiled_for_too_long_is_refused() {
    let output = check(&slow(60), 1);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(i32::from(Exit::Usage.code())), "{said}");
    let expected = [
        "cannot compile component `",
        "hello.wasm`",
        "takes more than 120 s of CPU time to compile",
        "help:",
        "leave out",
    ];
    let mut rest = said.as_ref();
    for words in expected {
        let at = rest.find(words).unwrap_or_else(|| panic!("no `{words}` in:\n{said}"));
        rest = &rest[at + words.len()..];
    }
}

#[test]
fn the_bound_of_cpu_time_can_only_be_made_tighter() {
    let folder = Folder::new();
    let component = folder.write("few.wasm", slow(1));
    for (seconds, ends_well) in [("120", true), ("121", false), ("0", false), ("-1", false), ("x", false)] {
        let mut compile = Command::new(program("gleaner-compile"));
        compile.arg(&component).arg("--cache").arg(folder.path().join(seconds)).args(["--cpu-seconds", seconds]);
        let output = compile.output().expect("gleaner-compile starts");
        assert_eq!(output.status.success(), ends_well, "{seconds}: {}", String::from_utf8_lossy(&output.stderr));
    }
}
