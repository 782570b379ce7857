use std::process::Command;

use super::*;

#[tokio::test]
async fn the_description_has_each_request_and_a_foreign_tool_accepts_it() {
    let folder = TempDir::new().unwrap();
    let cloud = cloud(&folder).await;
    let answer = send(&cloud, (Method::GET, "/v1/openapi.json"), None, &[], "").await;
    assert_eq!(answer.headers[header::CONTENT_TYPE], "application/json");
    let description = answer.json();
    let mut count = 0;
    for Endpoint { method, path, role, .. } in endpoints() {
        let operation = &description["paths"][path][method.as_str().to_ascii_lowercase()];
        assert!(operation["summary"].is_string(), "{method} {path}");
        assert_eq!(operation["security"].is_array(), role.is_some(), "{method} {path}");
        count += 1;
    }
    let paths = description["paths"].as_object().unwrap().values();
    assert_eq!(paths.map(|path| path.as_object().unwrap().len()).sum::<usize>(), count);
    let schemas = description["components"]["schemas"].as_object().unwrap();
    for name in ["VehicleSummary", "FleetDeployment", "FleetClip", "Problem", "VehicleStatus"] {
        assert!(schemas[name]["properties"].is_object(), "{name}");
    }
    let file = folder.path().join("openapi.json");
    std::fs::write(&file, &answer.body).unwrap();
    let python = concat!(env!("CARGO_MANIFEST_DIR"), "/../../.venv/bin/python");
    let module = |name: &str, arguments: &[&str]| {
        Command::new(python).args(["-I", "-m", name]).args(arguments).output()
    };
    let shown = file.to_str().unwrap();
    match module("openapi_spec_validator", &["--help"]) {
        Ok(output) if output.status.success() => {
            let output = module("openapi_spec_validator", &["--errors", "all", shown]).unwrap();
            let text = String::from_utf8_lossy(&output.stdout).into_owned();
            assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
        }
        _ => println!("not validated: `.venv` has no package openapi-spec-validator"),
    }
}
