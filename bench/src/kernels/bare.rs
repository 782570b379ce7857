//! Runs the bench lambda on a bare wasmtime engine, without the host.

use gleaner_tests::root;
use wasmtime::Store;
use wasmtime::component::types::ComponentItem;
use wasmtime::component::{Component, Func, Linker, ResourceTable, ResourceType, Val};
use wasmtime_wasi::{WasiCtx, WasiCtxView, WasiView};

use super::checks::EngineChecks;

/// Fuel and epochs that never run out.
const PLENTY: u64 = u64::MAX / 2;

/// The component, compiled with some checks.
pub struct BareComponent {
    component: Component,
    checks: EngineChecks,
}

impl BareComponent {
    /// Compiles the component.
    pub fn compile(checks: EngineChecks) -> Self {
        let path = root().join("bench/lambdas/kernels/rust/build/bench_kernels.wasm");
        Self { component: checks.compile(&path), checks }
    }
}

/// An instance that does one kind of work.
pub struct BareInstance {
    store: Store<BareState>,
    on_wake: Func,
}

struct BareState {
    ctx: WasiCtx,
    table: ResourceTable,
}

impl WasiView for BareState {
    fn ctx(&mut self) -> WasiCtxView<'_> {
        WasiCtxView { ctx: &mut self.ctx, table: &mut self.table }
    }
}

/// Links the imports of the host to functions that fail: kernels never call them.
fn refuse_host_calls(
    linker: &mut Linker<BareState>,
    component: &Component,
) -> wasmtime::Result<()> {
    let engine = component.engine();
    for (interface, item) in component.component_type().imports(engine) {
        let ComponentItem::ComponentInstance(items) = item.ty else { continue };
        if !interface.starts_with("gleaner:lambda/") {
            continue;
        }
        let mut interface = linker.instance(interface)?;
        for (name, item) in items.exports(engine) {
            match item.ty {
                ComponentItem::ComponentFunc(_) => {
                    interface.func_new(name, |_, _, _, _| {
                        Err(wasmtime::Error::msg("there is no host here"))
                    })?;
                }
                ComponentItem::Resource(_) => {
                    interface.resource(name, ResourceType::host::<()>(), |_, _| Ok(()))?;
                }
                _ => {}
            }
        }
    }
    Ok(())
}

impl BareInstance {
    /// An instance after `init`, configured to do `work`.
    pub fn new(compiled: &BareComponent, work: &str) -> Self {
        let BareComponent { component, checks } = compiled;
        let mut linker = Linker::new(component.engine());
        wasmtime_wasi::p2::add_to_linker_sync(&mut linker).expect("WASI");
        refuse_host_calls(&mut linker, component).expect("imports");
        let mut store = Store::new(
            component.engine(),
            BareState { ctx: WasiCtx::builder().build(), table: ResourceTable::new() },
        );
        if checks.fuel {
            store.set_fuel(PLENTY).expect("fuel is counted");
        }
        if checks.epochs {
            store.set_epoch_deadline(PLENTY);
        }
        let instance = linker.instantiate(&mut store, component).expect("an instance");
        let mut function =
            |name| instance.get_func(&mut store, name).expect("the world of lambdas");
        let (init, on_wake) = (function("init"), function("on-wake"));
        let entry = |key: &str, value: Val| {
            Val::Record(vec![
                ("key".to_owned(), Val::String(key.to_owned())),
                ("value".to_owned(), value),
            ])
        };
        let variant = |case: &str, value| Val::Variant(case.to_owned(), Some(Box::new(value)));
        let config = Val::List(vec![
            entry("work", variant("text", Val::String(work.to_owned()))),
            entry("rounds", variant("integer", Val::S64(0))),
        ]);
        let mut answer = [Val::Bool(false)];
        init.call(&mut store, &[config], &mut answer).expect("init");
        assert!(matches!(answer, [Val::Result(Ok(_))]), "{answer:?}");
        Self { store, on_wake }
    }

    /// Does the work `rounds` times; returns the last result.
    pub fn rounds(&mut self, rounds: u64) -> f64 {
        let tick = vec![("at-ns".to_owned(), Val::S64(0)), ("missed".to_owned(), Val::U64(rounds))];
        let wake = Val::Variant("tick".to_owned(), Some(Box::new(Val::Record(tick))));
        let mut answer = [Val::Bool(false)];
        self.on_wake.call(&mut self.store, &[wake], &mut answer).expect("a wake");
        match answer {
            [Val::Result(Err(Some(result)))] => match *result {
                Val::String(number) => number.parse().expect("a number"),
                other => panic!("unexpected result {other:?}"),
            },
            other => panic!("unexpected result {other:?}"),
        }
    }
}
