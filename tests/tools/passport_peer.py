"""Validates a battery passport with independent tools.

usage: passport_peer.py schema SCHEMA.json PASSPORT.json   checks it with jsonschema against a published JSON schema
       passport_peer.py submodel PASSPORT.json             checks an IDTA Product Condition as a submodel of the Asset Administration Shell,
                                                           with aas-submodel-validate, which has IDTA's template (1.0.2)

Prints one line per fault; no output means no fault.
"""
import json
import subprocess
import sys
import tempfile

MODEL = "urn:samm:io.admin-shell.idta.batterypass.product_condition:1.0.2#"
DOCUMENT = "urn:samm:io.admin-shell.idta.handover_documentation:2.0.0#DocumentIdentifier"


def against_schema(schema, passport):
    import jsonschema

    with open(schema, encoding="utf-8") as text:
        validator = jsonschema.Draft4Validator(json.load(text))
    for fault in sorted(validator.iter_errors(passport), key=lambda fault: fault.json_path):
        yield f"{fault.json_path}: {fault.message}"


def semantic(value):
    return {"type": "ExternalReference", "keys": [{"type": "GlobalReference", "value": value}]}


def element(name, value):
    """A member of the passport as an element of the submodel."""
    identity = {"idShort": name, "semanticId": semantic(MODEL + name[0].lower() + name[1:])}
    if isinstance(value, dict):
        return {**identity, "modelType": "SubmodelElementCollection", "value": [element(*member) for member in value.items()]}
    if isinstance(value, list):
        return {**identity, "modelType": "SubmodelElementList", "orderRelevant": False, **listed(value)}
    kinds = {"LastUpdate": "xs:dateTime", "NumberOfFullCyclesValue": "xs:unsignedInt"}
    kind = kinds.get(name, "xs:string" if isinstance(value, str) else "xs:float")
    return {**identity, "modelType": "Property", "valueType": kind, "value": str(value)}


def listed(values):
    """A list of negative events, or of document identifiers."""
    if values and isinstance(values[0], dict):
        event = {"modelType": "SubmodelElementCollection", "semanticId": semantic(MODEL + "NegativeEvent")}
        items = [{**event, "value": [element(*member) for member in value.items()]} for value in values]
        return {"typeValueListElement": "SubmodelElementCollection", "value": items}
    items = [{"modelType": "Property", "semanticId": semantic(DOCUMENT), "valueType": "xs:string", "value": value} for value in values]
    head = {"typeValueListElement": "Property", "valueTypeListElement": "xs:string"}
    return {**head, "value": items} if items else head


def against_template(passport):
    submodel = {
        "modelType": "Submodel", "id": "urn:example:passport", "idShort": "ProductCondition", "kind": "Instance",
        "semanticId": semantic(MODEL + "ProductCondition"), "submodelElements": [element(*member) for member in passport.items()],
    }  # fmt: skip
    with tempfile.NamedTemporaryFile("w", suffix=".json", encoding="utf-8") as file:
        json.dump(submodel, file)
        file.flush()
        command = [sys.executable, "-m", "aas_submodel_validate", "--format", "json", "--no-bundle", "--require-all-judged", file.name]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
    report = json.loads(run.stdout)
    findings = [finding for finding in report["findings"] if finding["severity"] == "error"]
    yield from (f"{finding['subject']}: {finding['message']}" for finding in findings)
    if run.returncode != 0 and not findings:
        yield f"aas-submodel-validate ended with {run.returncode}: {run.stdout}{run.stderr}"


def main():
    with open(sys.argv[-1], encoding="utf-8") as text:
        passport = json.load(text)
    faults = against_schema(sys.argv[2], passport) if sys.argv[1] == "schema" else against_template(passport)
    for fault in faults:
        print(fault)


main()
